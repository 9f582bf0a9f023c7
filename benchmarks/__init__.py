"""Speed and memory: each figure a ratio against something measured in the same run."""
