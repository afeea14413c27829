"""From sweeps and images to boards, edges, views and intrinsics."""
