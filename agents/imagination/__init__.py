"""The thesis' imagination learner: mixture world model, rollouts, epistemic filter."""
