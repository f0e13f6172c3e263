"""Two public recordings, each with its reader, and their `[data]` kinds."""
