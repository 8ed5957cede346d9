"""The rigs that ship, a TOML file each, and the devices that rig files describe."""
