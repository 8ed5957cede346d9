"""How steady a network is: severities, motion, arithmetic."""
