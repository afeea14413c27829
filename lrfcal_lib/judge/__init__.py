"""Whether a calibration can be trusted, for what error, and what to record next."""
