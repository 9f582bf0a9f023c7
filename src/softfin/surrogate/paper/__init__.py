"""The paper's surrogate: PosNet and ForceNet, which see a window of past samples (Sec. III-B)."""
