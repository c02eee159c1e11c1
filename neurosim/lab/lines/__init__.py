"""Virtual robots that speak the text-line protocol of docs/lines.md."""
