"""The worst images and their causes."""
