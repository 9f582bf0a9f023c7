"""The paper's surrogate: PosNet and ForceNet, whose input is a window of past samples (Sec.
III-B)."""
