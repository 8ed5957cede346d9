"""Pictures for people: contact sheets, galleries, views of a body."""
