"""The texts and pages that users read."""
