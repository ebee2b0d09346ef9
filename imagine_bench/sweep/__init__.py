"""Grids of benches, each a TOML file: studies (one factor changed at a time) and the benchmark suite."""
