"""The science of advnerf: fields, rendering, driving, attacks and reports. No sockets, no devices, no torch on import."""
