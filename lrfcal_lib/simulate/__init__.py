"""A simulated rig that behaves like the real sensors: the oracle that everything else is judged by.

Knows the geometry, the board, the camera model and the session's files; never a solver or the
preprocessing.
"""
