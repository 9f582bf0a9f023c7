"""The drives and force sensors that softfin can use, one folder each."""
