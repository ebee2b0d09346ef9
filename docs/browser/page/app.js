// The page: it reads the address, loads the physics, and joins keys and buttons to the game.

import { ArrowScene } from './arrow_scene.js';
import { ArrowControls } from './controls.js';
import { Dream } from './dream.js';
import { elementOf } from './elements.js';
import { rulesOf } from './families.js';
import { Game, generator } from './game.js';
import { PickControls } from './pick_controls.js';
import { PickScene } from './pick_scene.js';
import { readRow, rowFile } from './rows.js';
import { Motions } from './scene.js';
import { View } from './view.js';
import { percent } from './words.js';
import { readWorld, WorldError } from './world.js';

const EXAMPLES = [
  ['plain', 'arrow_puzzle'], ['hard', 'arrow_puzzle_hard'], ['four cubes that slip', 'arrows:cubes=4,slip=0.1'],
  ['six cubes', 'arrows:cubes=6'], ['turns in pairs', 'arrows:coupling=neighbour,forbid=none'],
  ['a hand that moves on', 'arrows:goal_change=0.3'], ['keys in another order', 'arrows:shuffle=7'],
  ['pick-and-place', 'pick_place'], ['pick-and-place that slips', 'pick_place:slip=0.1'],
];
const LEAST_FRAME_S = 1 / 240;
const MOST_FRAME_S = 0.1;

/** @param {string} id */
const find = (id) => document.getElementById(id);

/**
 * @param {string} file
 * @returns {Promise<Response>}
 */
async function fetched(file) {
  const answer = await fetch(new URL(file, import.meta.url));
  if (!answer.ok) throw new WorldError(`${file} is not there (${answer.status}).`);
  return answer;
}

/** The page with everything that it holds. */
class Page {
  constructor() {
    this.moving = null;
    this.waiting = null;
    this.queue = [];
    this.row = null;
    this.version = 0;
  }

  /** Load everything that the address asks for, and begin. */
  async start() {
    const address = new URLSearchParams(window.location.search);
    const rowName = address.get('row');
    if (rowName !== null) {
      this.row = readRow(await (await fetched(rowFile(rowName))).json());
    }
    const world = this.row?.world ?? readWorld(address.get('world') ?? 'arrow_puzzle');
    this.rules = rulesOf(world);
    const seed = Number(address.get('seed') ?? NaN);
    this.game = new Game(this.rules, Number.isInteger(seed) ? generator(seed) : Math.random);
    this.#describe();
    this.#askForFacts();
    await this.#loadScene();
    this.#listen();
    this.#begin();
    find('loading').hidden = true;
    document.body.dataset.ready = 'yes';
    requestAnimationFrame((now) => this.#frame(now));
    if (this.row) this.#offerEpisodes(Number(address.get('episode') ?? 1));
    this.#offerRows();
    if (world.cubes === 3 && !world.isPickPlace) this.#loadDream().catch((error) => console.warn(error.message));
  }

  #describe() {
    const { world } = this.rules;
    const Controls = world.isPickPlace ? PickControls : ArrowControls;
    this.controls = new Controls(this.rules, (action) => this.#ask(action), () => this.#update());
    document.title = `${this.controls.title} · imagine_bench`;
    find('title').textContent = this.controls.title;
    find('goal').textContent = this.controls.goal;
    find('keys').replaceChildren(...this.controls.keys);
    find('world').value = world.line;
    find('cubes').style.gridTemplateColumns = `repeat(${this.controls.columns}, 1fr)`;
    find('cubes').replaceChildren(...this.controls.cards.map((card) => card.box));
    find('chips').replaceChildren(...EXAMPLES.map(([name, line]) => {
      const link = document.createElement('a');
      link.href = `?world=${encodeURIComponent(line)}`;
      link.textContent = name;
      if (line === world.line) link.setAttribute('aria-current', 'page');
      return link;
    }));
    this.tags = Array.from({ length: this.controls.nObjects }, (_, index) => elementOf('span', '', String(index + 1)));
    find('tags').replaceChildren(...this.tags);
  }

  #askForFacts() {
    const worker = new Worker(new URL('facts_worker.js', import.meta.url), { type: 'module' });
    worker.onmessage = ({ data }) => {
      find('chance').textContent = percent(data.chance);
      find('optimum').textContent = percent(data.optimum);
      worker.terminate();
    };
    worker.postMessage(this.rules.world.line);
  }

  async #loadScene() {
    const { cubes, isPickPlace } = this.rules.world;
    const scene = isPickPlace ? 'data/scene_pick_place' : `data/scene_${cubes}`;
    const motions = isPickPlace ? 'data/motions_pick_place' : 'data/motions';
    const text = async (file) => (await fetched(file)).text();
    const json = async (file) => (await fetched(file)).json();
    const [{ default: load }, xml, facts, index, rows] = await Promise.all([
      import('./mujoco/mujoco.js'), text(`${scene}.xml`), json(`${scene}.json`),
      json(`${motions}.json`), fetched(`${motions}.bin`).then((answer) => answer.arrayBuffer()),
    ]);
    const mujoco = await load();
    const Scene = isPickPlace ? PickScene : ArrowScene;
    this.scene = new Scene(mujoco, xml, facts, new Motions(index, rows));
    this.view = new View(find('view'));
    this.view.show(this.scene);
  }

  async #loadDream() {
    const [weights, image] = await Promise.all([
      fetched('data/model.bin').then((answer) => answer.arrayBuffer()),
      fetched('data/frames.png').then((answer) => answer.blob()),
    ]);
    this.dream = new Dream(weights, await createImageBitmap(image, { colorSpaceConversion: 'none' }));
    find('dream').hidden = false;
    this.dream.look(this.rules.rowOf(this.game.state));
    document.body.dataset.dream = 'yes';
  }

  #listen() {
    document.addEventListener('keydown', (event) => this.#key(event));
    find('again').addEventListener('click', () => this.#anew());
    find('look').addEventListener('click', () => {
      if (!this.moving) this.dream?.look(this.rules.rowOf(this.game.state));
    });
    const canvas = find('view');
    canvas.addEventListener('pointerdown', (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener('pointermove', (event) => {
      if (!canvas.hasPointerCapture(event.pointerId)) return;
      this.view.turn -= event.movementX * 0.006;
      this.view.height = Math.min(Math.max(this.view.height + event.movementY * 0.004, 0.15), 1.45);
    });
    canvas.addEventListener('wheel', (event) => {
      if (!event.ctrlKey) return;
      event.preventDefault();
      this.view.distance = Math.min(Math.max(this.view.distance * Math.exp(event.deltaY * 0.004), 0.5), 2);
    }, { passive: false });
  }

  /** @param {KeyboardEvent} event */
  #key(event) {
    const inField = event.target instanceof HTMLInputElement || event.target instanceof HTMLSelectElement;
    if (inField || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key.toLowerCase() === 'n') this.#anew();
    else if (!this.controls.key(event.key)) return;
    event.preventDefault();
  }

  #anew() {
    this.game.reset();
    this.#begin();
  }

  /** Show the start of an episode; nothing that was asked for before is carried out in it. */
  #begin() {
    this.queue = [];
    this.moving = null;
    this.waiting = null;
    this.scene.place(this.game.state);
    this.view.hidesHand = !this.game.shown;
    this.dream?.look(this.rules.rowOf(this.game.state));
    this.#say({ text: this.controls.opening(this.game.state), tone: '' });
    this.#update();
  }

  /**
   * Carry out a macro-action, or wait until the arm is free.
   * @param {number} action
   */
  #ask(action) {
    if (this.moving) {
      this.waiting = action;
      return;
    }
    if (this.game.over || this.queue.length > 0) return;
    this.#move(action, this.game.intend(action));
  }

  /**
   * @param {number} action
   * @param {number[]} intended
   */
  #move(action, intended) {
    const { state } = this.game;
    const slips = this.rules.slips(state, action, intended);
    this.moving = { action, intended, slips };
    this.scene.begin(this.rules, state, action, slips);
    document.body.dataset.moving = 'yes';
    this.#say({ text: 'The arm is moving …', tone: '' });
    this.#update();
  }

  /** @param {number} now in milliseconds */
  #frame(now) {
    const passed = Math.min(Math.max((now - (this.before ?? now)) / 1000, LEAST_FRAME_S), MOST_FRAME_S);
    this.before = now;
    if (this.moving) {
      const speed = Number(find('speed').value);
      const moves = this.scene.advance(Math.min(Math.ceil((passed * speed) / this.scene.timestep), 2000));
      if (!moves) this.#arrive();
    } else if (this.queue.length > 0) {
      const next = this.queue.shift();
      this.#move(next.action, next.reached);
    }
    if (this.#looksNew()) {
      this.view.draw();
      this.#placeTags();
    }
    requestAnimationFrame((later) => this.#frame(later));
  }

  /** @returns {boolean} whether anything in the picture may have changed since it was drawn */
  #looksNew() {
    const { turn, height, distance, canvas, hidesHand, sky } = this.view;
    const now = [turn, height, distance, canvas.clientWidth, canvas.clientHeight, hidesHand, sky, this.version].join();
    const changed = this.moving !== null || now !== this.drawn;
    this.drawn = this.moving ? '' : now;
    return changed;
  }

  #arrive() {
    const { action, intended, slips } = this.moving;
    this.moving = null;
    const { macrostate, fault } = this.scene.read(intended);
    const outcome = this.game.reach(action, macrostate);
    const asIntended = macrostate.join() === intended.join();
    const why = fault ?? (asIntended ? null : `the objects read ${macrostate.join(' ')}, the rules say ${intended.join(' ')}`);
    this.scene.gesture(macrostate);
    this.view.hidesHand = !this.game.shown;
    this.dream?.follow(this.rules.turns[action], this.rules.rowOf(macrostate), outcome);
    this.#say(this.controls.happened(this.game, outcome, slips, why));
    document.body.dataset.moving = 'no';
    document.body.dataset.end = this.game.over ? (outcome.success ? 'solved' : 'lost') : '';
    this.#update();
    const next = this.waiting;
    this.waiting = null;
    if (next !== null && this.queue.length === 0) this.#ask(next);
  }

  /** @param {{text: string, tone: string}} said */
  #say({ text, tone }) {
    find('happened').textContent = text;
    find('happened').className = tone;
  }

  #update() {
    this.version += 1;
    const { state, left, over, played, solved } = this.game;
    this.controls.update(this.game, over || this.queue.length > 0);
    this.tags.forEach((tag, index) => tag.classList.toggle('chosen', index === this.controls.chosen));
    find('left').textContent = `${left} ${this.controls.unit[Number(left !== 1)]} left`;
    find('yours').textContent = `${solved} of ${played}`;
    document.body.dataset.state = state.join();
    document.body.dataset.left = String(left);
  }

  #placeTags() {
    const { data, facts } = this.scene;
    this.tags.forEach((tag, index) => {
      const at = facts.object_qpos[index];
      const { x, y } = this.view.project([data.qpos[at], data.qpos[at + 1], data.qpos[at + 2] - 0.045]);
      tag.style.left = `${100 * x}%`;
      tag.style.top = `calc(${100 * y}% + 12px)`;
    });
  }

  async #offerRows() {
    const names = await fetched('data/rows/index.json').then((answer) => answer.json(), () => []);
    find('agents').hidden = names.length === 0;
    find('rows').replaceChildren(...names.map(([name, title]) => {
      const link = document.createElement('a');
      link.href = `?row=${encodeURIComponent(name)}`;
      link.textContent = title;
      return link;
    }));
  }

  /** @param {number} first the episode that is shown, from 1 */
  #offerEpisodes(first) {
    find('watching').hidden = false;
    find('player').textContent = 'The agent, here';
    find('episode').replaceChildren(...this.row.episodes.map((episode, index) => {
      const option = document.createElement('option');
      option.value = String(index);
      const end = episode.success ? 'solved' : 'not solved';
      const why = episode.reproducible === false ? ', as it is not reproducible' : '';
      option.textContent = `${index + 1} · ${end} in ${episode.actions.length}${why}`;
      return option;
    }));
    const known = Number.isInteger(first) && first >= 1 && first <= this.row.episodes.length;
    find('episode').value = String(known ? first - 1 : 0);
    find('watch').addEventListener('click', () => this.#watch());
    this.#watch();
  }

  #watch() {
    const episode = this.row.episodes[Number(find('episode').value)];
    this.game.reset([...episode.start]);
    this.#begin();
    this.queue = episode.actions.map((action, at) => ({ action, reached: episode.states[at] }));
    const still = episode.actions.length === 0 ? ` ${this.controls.still}` : '';
    this.#say({ text: `Playing the episode of ${this.row.title}.${still}`, tone: '' });
    this.#update();
  }
}

const page = new Page();
page.start().catch((error) => {
  const text = error instanceof WorldError ? error.message : `The page cannot begin: ${error.message}`;
  find('loading').textContent = text;
  find('loading').hidden = false;
  document.body.dataset.ready = 'refused';
  if (!(error instanceof WorldError)) console.error(error);
});
