"""What tests and benchmarks compare with and feed in: independent formulas, sample files and damaged inputs."""
