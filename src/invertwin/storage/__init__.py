"""The disk: folders, runs, untrusted files."""
