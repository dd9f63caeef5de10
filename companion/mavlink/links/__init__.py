"""UDP, TCP, serial, HTTP and Zenoh endpoints that carry MAVLink and related formats."""
