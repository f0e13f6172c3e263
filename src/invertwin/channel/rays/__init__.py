"""The scene as rays see it: tables, topology, visibility."""
