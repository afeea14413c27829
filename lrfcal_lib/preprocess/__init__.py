"""From raw scans and images to the edges and planes the solvers work on."""
