"""The gap workflow on hidden effects: sealed cases, verdicts, and only then the key."""
