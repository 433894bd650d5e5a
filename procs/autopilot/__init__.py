"""The MAVLink bridge: what the navigator wants becomes what an ArduCopter may do."""
