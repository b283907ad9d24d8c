// Tables that can be sorted by the columns whose heads have `data-sort`. The cells of such a column have their value in
// `data-value`.

/** Natural order: 2 comes before 10. */
const alphabet = new Intl.Collator(undefined, { numeric: true });

/**
 * @param {HTMLTableRowElement} row
 * @param {number} column
 */
function cellValue(row, column) {
  return row.children[column]?.getAttribute('data-value') ?? '';
}

/**
 * The cells of a table's head.
 * @param {HTMLTableElement | null} table
 */
function headsOf(table) {
  return [...(table?.tHead?.rows[0]?.cells ?? [])];
}

/**
 * Sorts the rows by the column that the header marks, else by their `data-place`, and moves only those that are out of
 * place.
 * @param {HTMLTableSectionElement} body
 */
export function sort(body) {
  const heads = headsOf(body.closest('table'));
  const column = heads.findIndex((head) => head.hasAttribute('aria-sort'));
  const rows = [...body.rows];
  const wanted = [...rows].sort((one, other) => Number(one.dataset.place) - Number(other.dataset.place));
  const head = heads[column];
  if (head) {
    const sign = head.getAttribute('aria-sort') === 'descending' ? -1 : 1;
    wanted.sort((one, other) => {
      const [a, b] = [cellValue(one, column), cellValue(other, column)];
      const order = head.dataset.sort === 'number' ? Number(a) - Number(b) : alphabet.compare(a, b);
      return sign * order;
    });
  }
  wanted.forEach((row, place) => {
    if (body.rows[place] !== row) {
      body.insertBefore(row, body.rows[place] ?? null);
    }
  });
}

/**
 * Makes the heads of the columns that can be sorted buttons.
 * @param {HTMLTableElement} table
 * @param {HTMLTableSectionElement} body
 */
export function makeSortable(table, body) {
  const heads = headsOf(table);
  for (const head of heads) {
    if (!head.dataset.sort) {
      continue;
    }
    const button = document.createElement('button');
    button.type = 'button';
    button.textContent = head.textContent;
    button.addEventListener('click', () => {
      const turn = head.getAttribute('aria-sort') === 'ascending' ? 'descending' : 'ascending';
      for (const other of heads) {
        other.removeAttribute('aria-sort');
      }
      head.setAttribute('aria-sort', turn);
      sort(body);
    });
    head.replaceChildren(button);
  }
}
