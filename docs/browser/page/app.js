// The page: it reads the address, loads the physics, and joins keys and buttons to the game.

import { Dream } from './dream.js';
import { Game, generator } from './game.js';
import { readRow, rowFile } from './rows.js';
import { Rules } from './rules.js';
import { Motions, Scene } from './scene.js';
import { View } from './view.js';
import { ARROWS, goalOf, happened, oddities, percent } from './words.js';
import { readWorld, WorldError } from './world.js';

const EXAMPLES = [
  ['plain', 'arrow_puzzle'], ['hard', 'arrow_puzzle_hard'], ['four cubes that slip', 'arrows:cubes=4,slip=0.1'],
  ['six cubes', 'arrows:cubes=6'], ['turns in pairs', 'arrows:coupling=neighbour,forbid=none'],
  ['a hand that moves on', 'arrows:goal_change=0.3'], ['keys in another order', 'arrows:shuffle=7'],
];
const ORDINALS = ['first', 'second', 'third', 'fourth', 'fifth', 'sixth'];
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
    this.chosen = 0;
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
    this.rules = new Rules(world);
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
    if (world.cubes === 3) this.#loadDream().catch((error) => console.warn(error.message));
  }

  #describe() {
    const { world } = this.rules;
    find('goal').textContent = [goalOf(this.rules), oddities(world)].join(' ').trim();
    find('world').value = world.line;
    find('last').textContent = String(world.cubes);
    find('cubes').style.gridTemplateColumns = `repeat(${world.cubes > 3 ? Math.ceil(world.cubes / 2) : world.cubes}, 1fr)`;
    find('chips').replaceChildren(...EXAMPLES.map(([name, line]) => {
      const link = document.createElement('a');
      link.href = `?world=${encodeURIComponent(line)}`;
      link.textContent = name;
      if (line === world.line) link.setAttribute('aria-current', 'page');
      return link;
    }));
    this.cards = Array.from({ length: world.cubes }, (_, cube) => this.#card(cube));
    find('cubes').replaceChildren(...this.cards.map((card) => card.box));
    this.tags = this.cards.map((_, cube) => {
      const tag = document.createElement('span');
      tag.textContent = String(cube + 1);
      return tag;
    });
    find('tags').replaceChildren(...this.tags);
  }

  /**
   * @param {number} cube
   */
  #card(cube) {
    const box = document.createElement('div');
    box.className = 'cube';
    const part = (kind, name, text) => {
      const element = document.createElement(kind);
      element.className = name;
      element.textContent = text;
      return element;
    };
    const arrow = part('span', 'arrow', '');
    const asked = part('span', 'asked', '');
    const turns = part('span', 'turns', '');
    for (const [clockwise, sign, words] of [[false, '↺', 'counter-clockwise'], [true, '↻', 'clockwise']]) {
      const button = part('button', '', sign);
      button.type = 'button';
      button.setAttribute('aria-label', `Turn the ${ORDINALS[cube]} cube ${words}`);
      button.addEventListener('click', () => {
        this.#choose(cube);
        this.#ask(cube, clockwise);
      });
      turns.append(button);
    }
    box.append(part('span', 'name', `cube ${cube + 1}`), document.createElement('br'), arrow, asked, turns);
    return { box, arrow, asked, buttons: [...turns.children] };
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
    const { cubes } = this.rules.world;
    const text = async (file) => (await fetched(file)).text();
    const json = async (file) => (await fetched(file)).json();
    const [{ default: load }, xml, facts, index, rows] = await Promise.all([
      import('./mujoco/mujoco.js'), text(`data/scene_${cubes}.xml`), json(`data/scene_${cubes}.json`),
      json('data/motions.json'), fetched('data/motions.bin').then((answer) => answer.arrayBuffer()),
    ]);
    const mujoco = await load();
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
    const cube = Number(event.key) - 1;
    if (cube >= 0 && cube < this.rules.world.cubes) this.#choose(cube);
    else if (event.key === 'ArrowRight') this.#ask(this.chosen, true);
    else if (event.key === 'ArrowLeft') this.#ask(this.chosen, false);
    else if (event.key.toLowerCase() === 'n') this.#anew();
    else return;
    event.preventDefault();
  }

  /** @param {number} cube */
  #choose(cube) {
    this.chosen = cube;
    this.#update();
  }

  #anew() {
    this.queue = [];
    this.moving = null;
    this.game.reset();
    this.#begin();
  }

  #begin() {
    this.scene.place(this.game.state);
    this.view.hidesHand = !this.game.shown;
    this.dream?.look(this.rules.rowOf(this.game.state));
    this.#say({ text: `Your turn. The hand points at cube ${this.game.state.at(-1) + 1}.`, tone: '' });
    this.#update();
  }

  /**
   * Turn a cube, or wait until the arm is free.
   * @param {number} cube
   * @param {boolean} clockwise
   */
  #ask(cube, clockwise) {
    if (this.moving) {
      this.waiting = [cube, clockwise];
      return;
    }
    if (this.game.over || this.queue.length > 0) return;
    const action = this.game.actionOf(cube, clockwise);
    const { outcome, slips } = this.game.intend(action);
    this.#move(action, outcome.macrostate, slips);
  }

  /**
   * @param {number} action
   * @param {number[]} intended
   * @param {boolean} slips
   */
  #move(action, intended, slips) {
    this.moving = { action, intended, slips };
    this.scene.begin(this.rules.turns[action], slips);
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
      this.#move(next.action, next.reached, this.game.slips(next.action, next.reached));
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
    const { macrostate, fault } = this.scene.read(intended.at(-1));
    const outcome = this.game.reach(macrostate);
    const asIntended = macrostate.join() === intended.join();
    const why = fault ?? (asIntended ? null : `the cubes read ${macrostate.join(' ')}, the rules say ${intended.join(' ')}`);
    this.scene.point(macrostate.at(-1));
    this.view.hidesHand = !this.game.shown;
    this.dream?.follow(this.rules.turns[action], this.rules.rowOf(macrostate), outcome);
    this.#say(happened(this.game, outcome, slips, why));
    document.body.dataset.moving = 'no';
    document.body.dataset.end = this.game.over ? (outcome.success ? 'solved' : 'lost') : '';
    this.#update();
    const next = this.waiting;
    this.waiting = null;
    if (next && this.queue.length === 0) this.#ask(...next);
  }

  /** @param {{text: string, tone: string}} said */
  #say({ text, tone }) {
    find('happened').textContent = text;
    find('happened').className = tone;
  }

  #update() {
    this.version += 1;
    const { state, left, over, shown, played, solved } = this.game;
    const pointed = state.at(-1);
    this.cards.forEach((card, cube) => {
      card.box.classList.toggle('chosen', cube === this.chosen);
      card.arrow.textContent = ARROWS[state[cube]];
      card.asked.textContent = shown && cube === pointed ? 'pointed at' : '';
      card.buttons.forEach((button) => { button.disabled = over || this.queue.length > 0; });
    });
    this.tags.forEach((tag, cube) => tag.classList.toggle('chosen', cube === this.chosen));
    find('left').textContent = `${left} ${left === 1 ? 'turn' : 'turns'} left`;
    find('yours').textContent = `${solved} of ${played}`;
    document.body.dataset.state = state.join();
    document.body.dataset.left = String(left);
  }

  #placeTags() {
    const { data, facts } = this.scene;
    this.tags.forEach((tag, cube) => {
      const at = facts.cube_qpos[cube];
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
      option.textContent = `${index + 1} · ${episode.success ? 'solved' : 'not solved'} in ${episode.actions.length}`;
      return option;
    }));
    const known = Number.isInteger(first) && first >= 1 && first <= this.row.episodes.length;
    find('episode').value = String(known ? first - 1 : 0);
    find('watch').addEventListener('click', () => this.#watch());
    this.#watch();
  }

  #watch() {
    const episode = this.row.episodes[Number(find('episode').value)];
    this.moving = null;
    this.game.reset([...episode.start]);
    this.#begin();
    this.queue = episode.actions.map((action, at) => ({ action, reached: episode.states[at] }));
    const still = episode.actions.length === 0 ? ' No arrow was turned in it, so the arm stands still here.' : '';
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
