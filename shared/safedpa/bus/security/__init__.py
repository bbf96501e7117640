"""Who may say it: roles, certificates, and the door in front of the router."""
