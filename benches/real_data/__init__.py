"""Real scans, coloured from their own photos: the table of docs/real-data.md."""
