// The exact facts of a world: how often chance solves it, and how often the best possible player does.
// Both are computed by going through every macrostate, as the package does; they are no estimates.

/**
 * Outcomes of every macro-action in every macrostate in which an episode goes on.
 * @param {import('./families.js').Rules} rules
 */
function tabulate(rules) {
  const alive = [];
  const begins = [0];
  const columns = [];
  const weights = [];
  const wins = [];
  for (let row = 0; row < rules.nStates; row += 1) {
    const state = rules.stateOf(row);
    if (!rules.isLegal(state) || rules.isGoal(state)) continue;
    alive.push(row);
    for (let action = 0; action < rules.nActions; action += 1) {
      let won = 0;
      for (const outcome of rules.outcomes(state, action)) {
        if (outcome.success) won += outcome.probability;
        if (outcome.terminated) continue;
        columns.push(rules.rowOf(outcome.macrostate));
        weights.push(outcome.probability);
      }
      wins.push(won);
      begins.push(columns.length);
    }
  }
  return { alive, begins, columns, weights, wins };
}

/**

/**
 * @param {import('./families.js').Rules} rules
 * @returns {{chance: number, optimum: number}}
 */
export function factsOf(rules) {
  const table = tabulate(rules);
  const actions = rules.nActions;
  let chance = new Float64Array(rules.nStates);
  let optimum = new Float64Array(rules.nStates);
  for (let left = 0; left < rules.horizon; left += 1) {
    const nextChance = new Float64Array(rules.nStates);
    const nextOptimum = new Float64Array(rules.nStates);
    table.alive.forEach((row, index) => {
      let sum = 0;
      let best = 0;
      for (let action = 0; action < actions; action += 1) {
        const pair = index * actions + action;
        let random = table.wins[pair];
        let played = table.wins[pair];
        for (let entry = table.begins[pair]; entry < table.begins[pair + 1]; entry += 1) {
          random += table.weights[entry] * chance[table.columns[entry]];
          played += table.weights[entry] * optimum[table.columns[entry]];
        }
        sum += random;
        best = Math.max(best, played);
      }
      nextChance[row] = sum / actions;
      nextOptimum[row] = best;
    });
    chance = nextChance;
    optimum = nextOptimum;
  }
  const mean = (values) => rules.starts.reduce((sum, row) => sum + values[row], 0) / rules.starts.length;
  return { chance: mean(chance), optimum: mean(optimum) };
}
