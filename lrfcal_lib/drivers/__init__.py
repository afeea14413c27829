"""Devices: pure codecs between bytes and values, which import nothing else of the library, and thin ports."""
