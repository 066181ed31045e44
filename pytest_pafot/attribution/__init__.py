"""Attribution of a collision to the vehicles that are responsible, with the reason and what avoids it."""
