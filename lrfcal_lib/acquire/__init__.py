"""Record sessions with a rig, in a terminal or in the data collection panel."""
