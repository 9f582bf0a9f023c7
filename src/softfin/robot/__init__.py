"""Several fins on one body: the node that distributes a wrench among them."""
