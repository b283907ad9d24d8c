// The TypeScript that docs/embedding.md prints is what a project can take: it compiles as it is printed, beside the
// downloaded types, without React and with the types of React 18 and 19.

import assert from 'node:assert/strict';
import { execFile } from 'node:child_process';
import { cpSync, mkdirSync, mkdtempSync, readFileSync, rmSync, symlinkSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { test } from 'node:test';
import { fileURLToPath } from 'node:url';

const GUIDE = readFileSync(new URL('../../docs/embedding.md', import.meta.url), 'utf8');
const TYPES = fileURLToPath(new URL('../../templates/embed.d.ts', import.meta.url));
const TOOLS = fileURLToPath(new URL('node_modules', import.meta.url));
const OPTIONS = {
  strict: true,
  skipLibCheck: false,
  noEmit: true,
  target: 'es2022',
  module: 'esnext',
  moduleResolution: 'bundler',
  jsx: 'react-jsx',
  types: [],
};

// What the types must know, and what they must refuse.
const USES = `
import { WebotsSimulation } from 'https://simulations.example.org/embed.js';
import type { EndedDetail, TimeDetail } from './embed.js';

const robot: WebotsSimulation = new WebotsSimulation();
const ended = ({ detail }: CustomEvent<EndedDetail>) => detail.message.length;
robot.addEventListener('ended', ended, { once: true });
robot.removeEventListener('ended', ended);
robot.addEventListener('click', ({ clientX }) => clientX);
document.createElement('webots-simulation').addEventListener('time', function ({ detail }) {
  const told: TimeDetail = detail;
  this.world = String(told.time);
});
// @ts-expect-error: it is read-only
robot.state = 'idle';
// @ts-expect-error: no such method
robot.begin();
// @ts-expect-error: a number is no world
robot.start(5);
// @ts-expect-error: no such detail
robot.addEventListener('time', ({ detail }) => detail.code);
`;
const REACT_USES = `
import { Simulation } from './simulation.jsx';

export const all = [
  <Simulation key="a" id="a" className="wide" world="a" autostart autoplay={false} viewer-script="b" lang="de" />,
  <Simulation key="b" autostart="" name={undefined} viewer="small" onEnded={({ code }) => code.length} />,
  // @ts-expect-error: no such attribute
  <Simulation key="c" wrold="a" />,
  // @ts-expect-error: no such viewer
  <Simulation key="d" viewer="large" />,
];
`;

/** The printed files of TypeScript, by the first name in the paragraph before each. */
function printed() {
  const blocks = [...GUIDE.matchAll(/\n\n((?:[^\n]+\n)+)\n```tsx?\n(.*?\n)```/gs)];
  const files = new Map(
    blocks.map(([, before = '', text = '']) => [/`([\w.-]+\.tsx?)`/.exec(before)?.[1] ?? '', text]),
  );
  assert.equal(files.size, GUIDE.match(/^```tsx?$/gm)?.length, `${[...files.keys()]}`);
  assert.ok(!files.has(''), `${[...files.keys()]}`);
  return files;
}

/**
 * What TypeScript says of a project.
 * @param {Map<string, string>} files
 * @param {string} [react] the package with its types
 */
async function compile(files, react) {
  const folder = mkdtempSync(join(tmpdir(), 'guide-'));
  try {
    cpSync(TYPES, join(folder, 'embed.d.ts'));
    for (const [name, text] of files) {
      writeFileSync(join(folder, name), text);
    }
    if (react) {
      mkdirSync(join(folder, 'node_modules/@types'), { recursive: true });
      symlinkSync(join(TOOLS, react), join(folder, 'node_modules/@types/react'));
    }
    writeFileSync(join(folder, 'tsconfig.json'), JSON.stringify({ compilerOptions: OPTIONS }));
    const command = [join(TOOLS, 'typescript/bin/tsc'), '--project', folder];
    return await new Promise((resolve) => {
      execFile(process.execPath, command, (error, output) => resolve(error ? `${error.code} ${output}` : 'fine'));
    });
  } finally {
    rmSync(folder, { recursive: true });
  }
}

test('the printed TypeScript compiles', async () => {
  const all = printed();
  const plain = new Map([...all].filter(([, text]) => !text.includes("'react'")));
  assert.ok(plain.size > 1 && plain.size < all.size, `${[...all.keys()]}`);
  plain.set('uses.ts', USES);
  const component = new Map([...all, ...plain, ['react-uses.tsx', REACT_USES]]);
  const said = await Promise.all([
    compile(plain),
    compile(component, '@types/react'),
    compile(component, 'types-react-18'),
  ]);
  assert.deepEqual(said, ['fine', 'fine', 'fine']);
});
