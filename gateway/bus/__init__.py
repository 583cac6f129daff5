"""The car on the bus: its service, its publications, the requests that come, and e-stops shared with other gateways."""
