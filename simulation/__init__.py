"""The synthetic robot cell: renders recordings with known truth, and the campaigns that use them."""
