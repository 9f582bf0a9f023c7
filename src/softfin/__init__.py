"""softfin: learn to make the force that you ask a soft fin for."""
