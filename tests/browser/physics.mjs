// Macro-actions in the physics of the page: random ones, some of which slip, one after another without a reset.

import { readFileSync } from 'node:fs';
import { pathToFileURL } from 'node:url';

const [folder, count, seed] = process.argv.slice(2);
const from = (name) => import(pathToFileURL(`${folder}/${name}`).href);
const { default: load } = await from('mujoco/mujoco.js');
const { Motions } = await from('scene.js');
const { ArrowScene } = await from('arrow_scene.js');
const { PickScene } = await from('pick_scene.js');
const { generator } = await from('game.js');
const { readWorld } = await from('world.js');
const { rulesOf } = await from('families.js');

const read = (name) => readFileSync(`${folder}/data/${name}`);
const mujoco = await load();
const random = generator(Number(seed));

/** The motions of a task. */
function motionsOf(name) {
  const bytes = read(`${name}.bin`);
  const rows = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
  return new Motions(JSON.parse(read(`${name}.json`)), rows);
}

/** One of some values. */
const oneOf = (values) => values[Math.floor(random() * values.length)];

/** A macro-action: any; but two of three times, the one that the human asks for, where the world ends at others. */
function drawnAction(rules, state) {
  const all = Array.from({ length: rules.nActions }, (_, action) => action);
  const isLed = rules.world.isPickPlace && random() < 2 / 3;
  return oneOf(isLed ? all.filter((action) => rules.isAskedFor(state, action)) : all);
}

/** Random macro-actions in a world. Pick-and-place begins anew at the end of each episode. */
function played(line, scene) {
  const rules = rulesOf(readWorld(line));
  const { isPickPlace } = rules.world;
  const rows = isPickPlace ? rules.starts : Array.from({ length: rules.nStates }, (_, row) => row);
  let state = rules.stateOf(oneOf(rows));
  scene.place(state);
  const result = { line, played: 0, as_ruled: 0, slipped: 0, faults: [], model: [scene.model.nq, scene.model.ngeom] };
  const kinds = new Set();
  while (result.played < Number(count)) {
    const action = drawnAction(rules, state);
    const { macrostate } = rules.draw(state, action, random());
    const slips = rules.slips(state, action, macrostate);
    scene.begin(rules, state, action, slips);
    while (scene.advance(50)) { /* until the arm is back */ }
    const reached = scene.read(macrostate);
    scene.gesture(reached.macrostate);
    const outcome = rules.judged(state, action, reached.macrostate);
    kinds.add(outcome.reward);
    result.played += 1;
    result.slipped += Number(slips);
    result.as_ruled += Number(reached.macrostate.join() === macrostate.join());
    if (reached.fault) result.faults.push(reached.fault);
    state = reached.macrostate;
    if (isPickPlace && outcome.terminated) {
      state = rules.stateOf(oneOf(rows));
      scene.place(state);
    }
  }
  scene.free();
  return { ...result, kinds: [...kinds] };
}

const found = [];
const turns = motionsOf('motions');
for (let cubes = 1; cubes <= 6; cubes += 1) {
  const scene = new ArrowScene(mujoco, read(`scene_${cubes}.xml`).toString(), JSON.parse(read(`scene_${cubes}.json`)), turns);
  found.push(played(`arrows:cubes=${cubes},forbid=none,slip=0.2`, scene));
}
const facts = JSON.parse(read('scene_pick_place.json'));
const scene = new PickScene(mujoco, read('scene_pick_place.xml').toString(), facts, motionsOf('motions_pick_place'));
found.push(played('pick_place:slip=0.2', scene));
process.stdout.write(JSON.stringify(found));
