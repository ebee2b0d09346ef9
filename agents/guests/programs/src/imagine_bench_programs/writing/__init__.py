"""How laws are found: the causes of a change, the laws that explain it, and a writer that plays to find out."""
