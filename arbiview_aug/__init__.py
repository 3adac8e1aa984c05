"""Re-render the labelled camera samples of one vehicle as the cameras of another would have seen them."""
