"""The rig: drive and force sensor, real ones or emulated behind the same protocols. Only emulation needs JAX."""
