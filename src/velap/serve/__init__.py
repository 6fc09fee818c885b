"""A trained policy outside this process: a server for robots by openpi's websocket protocol, and exported networks."""
