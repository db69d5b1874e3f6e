"""From detections to persons: who is who in several views, and in time."""
