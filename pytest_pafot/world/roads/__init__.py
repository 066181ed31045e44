"""Roads: straight roads, ways through networks of lanes, and junctions."""
