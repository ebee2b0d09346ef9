"""Encoders: frames to latents or codes, how they are made, and how they are probed."""
