// Computes the facts of a world beside the page, which stays quick meanwhile.

import { factsOf } from './facts.js';
import { Rules } from './rules.js';
import { readWorld } from './world.js';

onmessage = (event) => {
  postMessage(factsOf(new Rules(readWorld(event.data))));
};
