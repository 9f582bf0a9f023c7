"""What everything passes on: quantities, the action clock, the plant contract, configuration, errors."""
