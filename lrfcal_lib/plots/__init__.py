"""Figures of recordings, rigs and results."""
