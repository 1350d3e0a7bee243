"""Multiple shooting: what a problem is (`transcription`), and the methods that solve it."""
