"""Networks side by side: speed, accuracy, cameras."""
