"""The six commands, and what they share: composition, sweeps, errors in one line."""
