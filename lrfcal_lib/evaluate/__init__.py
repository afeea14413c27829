"""How good a calibration is: tables, uncertainty, the verdict, what to record next."""
