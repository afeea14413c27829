"""What a calibration comes to: tables, scenes, files, Monte-Carlo trials."""
