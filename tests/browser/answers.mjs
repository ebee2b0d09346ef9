// Answers of the page's modules, for Python's tests: questions come as JSON on stdin, answers go out as JSON.

import { readFileSync } from 'node:fs';
import { pathToFileURL } from 'node:url';

const [folder] = process.argv.slice(2);
const from = (name) => import(pathToFileURL(`${folder}/${name}.js`).href);
const { readWorld, WorldError } = await from('world');
const { rulesOf } = await from('families');
const { factsOf } = await from('facts');
const { readRow, rowFile } = await from('rows');
const { WorldModel } = await from('model');
const { percent } = await from('words');

/** The answer, or the sentence by which it is refused. */
function tried(ask) {
  try {
    return ask();
  } catch (error) {
    if (error instanceof WorldError) return { refused: error.message };
    throw error;
  }
}

const model = { path: null, found: null };
const kinds = {
  world: ({ line }) => {
    const rules = rulesOf(readWorld(line));
    const starts = rules.starts.map((row) => rules.stateOf(row));
    return { turns: rules.turns, states: rules.states, horizon: rules.horizon, starts };
  },
  outcomes: ({ line, asked }) => {
    const rules = rulesOf(readWorld(line));
    return asked.map(([state, action]) => rules.outcomes(state, action));
  },
  facts: ({ line }) => factsOf(rulesOf(readWorld(line))),
  percent: ({ share }) => percent(share),
  rowFile: ({ name }) => rowFile(name),
  row: ({ row }) => readRow(row).episodes.length,
  model: ({ path, rgba, action }) => {
    if (model.path !== path) {
      const bytes = readFileSync(path);
      model.found = new WorldModel(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength));
      model.path = path;
    }
    const latents = model.found.encode(rgba);
    const { latents: next, ...rest } = model.found.imagine(latents, action);
    return { latents: [...latents], next: [...next], image: [...model.found.decode(next)], ...rest };
  },
};

const questions = JSON.parse(readFileSync(0, 'utf8'));
process.stdout.write(JSON.stringify(questions.map((each) => tried(() => kinds[each.kind](each)))));
