"""How fast the learners compute, beside plain PyTorch."""
