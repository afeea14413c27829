"""Notebooks on a session, and the report made of them."""
