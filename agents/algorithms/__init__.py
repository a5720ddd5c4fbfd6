"""The published algorithms, a file each."""
