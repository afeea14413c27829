"""Devices: the range finder, the head and cameras, each behind a small class, and rigs made of
them.
"""
