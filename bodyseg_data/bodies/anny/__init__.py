"""The open body model: people, skeleton and postures of Anny."""
