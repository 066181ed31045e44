"""The roads that vehicles drive on."""
