// Macro-actions in the physics of the page: random turns, some of which slip, one after another without a reset.

import { readFileSync } from 'node:fs';
import { pathToFileURL } from 'node:url';

const [folder, count, seed] = process.argv.slice(2);
const from = (name) => import(pathToFileURL(`${folder}/${name}`).href);
const { default: load } = await from('mujoco/mujoco.js');
const { Motions, Scene } = await from('scene.js');
const { generator } = await from('game.js');
const { readWorld } = await from('world.js');
const { Rules } = await from('rules.js');

const read = (name) => readFileSync(`${folder}/data/${name}`);
const bytes = read('motions.bin');
const rows = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const motions = new Motions(JSON.parse(read('motions.json')), rows);
const mujoco = await load();
const random = generator(Number(seed));
const found = [];
for (let cubes = 1; cubes <= 6; cubes += 1) {
  const rules = new Rules(readWorld(`arrows:cubes=${cubes},forbid=none,slip=0.2`));
  const scene = new Scene(mujoco, read(`scene_${cubes}.xml`).toString(), JSON.parse(read(`scene_${cubes}.json`)), motions);
  let state = rules.stateOf(Math.floor(random() * rules.nStates));
  scene.place(state);
  const result = { cubes, played: 0, as_ruled: 0, slipped: 0, faults: 0, model: [scene.model.nq, scene.model.ngeom] };
  for (let each = 0; each < Number(count); each += 1) {
    const action = Math.floor(random() * rules.nActions);
    const { macrostate } = rules.draw(state, action, random());
    const slips = macrostate.join() === state.join();
    scene.begin(rules.turns[action], slips);
    while (scene.advance(50)) { /* until the arm is back */ }
    const reached = scene.read(macrostate.at(-1));
    result.played += 1;
    result.slipped += Number(slips);
    result.as_ruled += Number(reached.macrostate.join() === macrostate.join());
    result.faults += Number(reached.fault !== null);
    state = reached.macrostate;
  }
  scene.free();
  found.push(result);
}
process.stdout.write(JSON.stringify(found));
