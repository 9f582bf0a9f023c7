"""The force sensor: an ATI Axia80 over Ethernet."""
