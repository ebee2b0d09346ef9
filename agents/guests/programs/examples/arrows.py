"""The arrow puzzle, written by a person: three arrows, and the cube that the human points at."""

HUMAN = 0  # directions: 0 toward the human, then clockwise
STEP, GOAL, ILLEGAL = -1.0, 50.0, -5.0


def outcomes(symbols, action):
    """From three directions and the cube pointed at, to {(symbols after, reward, ended): probability}."""
    *arrows, pointed = symbols
    cube, counter_clockwise = divmod(action, 2)
    arrows[cube] = (arrows[cube] + (3 if counter_clockwise else 1)) % 4
    after = (*arrows, pointed)
    if len(set(arrows)) < len(arrows):  # two arrows point the same way
        return {(after, ILLEGAL, True): 1.0}
    if arrows[pointed] == HUMAN:
        return {(after, GOAL, True): 1.0}
    return {(after, STEP, False): 1.0}
