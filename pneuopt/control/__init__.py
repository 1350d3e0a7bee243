"""The loop around a plant: PID, dither, references, and what is read off the response: margins, metrics."""
