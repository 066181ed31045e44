"""What the commands beside pytest share: the policy that they are given, and work that goes on where it was stopped."""
