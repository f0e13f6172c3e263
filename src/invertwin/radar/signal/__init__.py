"""Beat signals and range profiles."""
