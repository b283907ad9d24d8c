//! The tables of reasons in `docs/protocol.md` are those of the source.

use std::collections::BTreeSet;

use webots_fleet::shared::domain::Reason;

use super::copy::root;

#[test]
fn the_documentation_lists_each_reason() {
    let text = std::fs::read_to_string(root().join("docs/protocol.md")).unwrap();
    let rows = text.lines().filter_map(|line| {
        let cells: Vec<&str> = line.split('|').map(str::trim).collect();
        let [_, code, blame, retry, meaning, _] = cells[..] else {
            return None;
        };
        let code = code.strip_prefix('`')?.strip_suffix('`')?;
        assert!(!meaning.is_empty(), "{line}");
        Some((code.to_owned(), blame.to_owned(), retry.to_owned()))
    });
    let documented: BTreeSet<_> = rows.collect();
    let word = |value: serde_json::Value| value.as_str().unwrap().to_owned();
    let reasons = Reason::ALL.iter().map(|reason| {
        let blame = serde_json::to_value(reason.blame()).unwrap();
        let retry = serde_json::to_value(reason.retry()).unwrap();
        (reason.code().to_owned(), word(blame), word(retry))
    });
    let reasons: BTreeSet<_> = reasons.collect();
    let missing: Vec<_> = reasons.difference(&documented).collect();
    let surplus: Vec<_> = documented.difference(&reasons).collect();
    assert!(
        missing.is_empty() && surplus.is_empty(),
        "not in docs/protocol.md: {missing:#?}; only there: {surplus:#?}"
    );
}
