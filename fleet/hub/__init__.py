"""A hub with certificates and rules: who may connect, and who may use which keys.

`access_rules` says it, pure. `certificate_authority` makes the certificates, `hub_store` keeps them beside the list of
identities. `invitation` lets another computer join.
"""
