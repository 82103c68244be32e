"""Speed against error: what every setting of a scene costs and how wrong it is."""
