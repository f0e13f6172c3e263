"""Fields: conductors, rough points, rough paths of several bounces."""
