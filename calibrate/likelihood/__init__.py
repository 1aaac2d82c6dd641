"""The maximum-likelihood model: corners, robot poses and what joins them."""
