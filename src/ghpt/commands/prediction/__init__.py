"""From a recording's key points to its 3D: frames in, shards between, merged files out."""
