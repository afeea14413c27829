"""A calibrated rig at work: features, lengths and files of what it scanned."""
