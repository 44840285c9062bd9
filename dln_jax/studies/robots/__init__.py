"""What is measured of robots: identification, tracking, learned trees, real logs and speed."""
