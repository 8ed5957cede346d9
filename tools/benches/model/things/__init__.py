"""The score that tells people from things: fitted on made rooms, and measured on others."""
