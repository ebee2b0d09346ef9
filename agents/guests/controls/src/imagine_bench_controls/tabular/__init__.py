"""Agents that keep tables of numbered states, without networks: the thesis' ancestors and controls."""
