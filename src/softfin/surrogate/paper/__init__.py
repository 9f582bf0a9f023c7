"""The paper's surrogate: PosNet and ForceNet, window by window (paper Sec. III-B)."""
