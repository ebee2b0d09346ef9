"""How laws are found: what a change belongs to, the laws that explain it, and a writer that plays to find out."""
