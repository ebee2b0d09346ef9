"""From a macro-action to joint motion."""
