"""Real recordings of other people through check, identification, import, estimate and diagnosis."""
