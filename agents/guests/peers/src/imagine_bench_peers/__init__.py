"""Agents of libraries as guests of imagine_bench: Stable-Baselines3, sheeprl's DreamerV3, torch-world's LeWM."""
