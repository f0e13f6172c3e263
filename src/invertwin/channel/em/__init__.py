"""Laws of plane waves and edges, without scene or rays."""
