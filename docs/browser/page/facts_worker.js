// Computes the facts of a world beside the page, which stays quick meanwhile.

import { factsOf } from './facts.js';
import { rulesOf } from './families.js';
import { readWorld } from './world.js';

onmessage = (event) => {
  postMessage(factsOf(rulesOf(readWorld(event.data))));
};
