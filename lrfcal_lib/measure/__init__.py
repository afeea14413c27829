"""Uses of a calibration: scenes, stations, lengths, and whether it still holds."""
