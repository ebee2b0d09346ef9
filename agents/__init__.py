"""Learners: encoder, world model, imagination, controller."""
