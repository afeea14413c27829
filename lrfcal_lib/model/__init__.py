"""What all stages speak of: geometry, cameras, boards, observations."""
