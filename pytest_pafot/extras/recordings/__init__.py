"""What others recorded or wrote, as values: tracks of vehicles, and the part of OpenSCENARIO that is manoeuvres."""
