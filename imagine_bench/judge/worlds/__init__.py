"""Questions about a whole world, whose answers and their exact probabilities are enumerated."""
