"""Recordings on disk: opened, checked and written; codecs and importers."""
