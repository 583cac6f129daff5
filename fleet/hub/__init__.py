"""A hub with certificates and rules: who may connect, and who may use which keys.

`rules` says it, pure. `authority` makes the certificates, `hub_store` keeps them beside the list of identities.
`invitation` lets another computer join.
"""
