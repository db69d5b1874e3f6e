"""Recordings without a licence: a body, its motion, a detector, real rigs."""
