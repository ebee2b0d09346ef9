"""Trained encoders, MJCF and textures, reached as package resources."""
