"""Agents from other people's libraries, trained by their own loops."""
