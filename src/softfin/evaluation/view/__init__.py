"""A fin to look at: a plant is rolled and drawn, its bent shape, its force and the traces, as a
film or a page."""
