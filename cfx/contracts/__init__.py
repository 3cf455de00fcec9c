"""The contracts that components of each kind must keep.

`check_contract` is the whole test of a component, with pytest or without:

    def test_contract():
        check_contract(MyModel())

A contract is a module of this package, `cfx.contracts.models` for models and so on; each of its
public functions is a statement. Importing this package imports nothing heavy.
"""

from cfx.contracts.contract import Contract as Contract
from cfx.contracts.contract import NotApplicable as NotApplicable
from cfx.contracts.contract import check_contract as check_contract
from cfx.contracts.contract import contract_for as contract_for
from cfx.contracts.contract import violations as violations

__all__ = ["Contract", "NotApplicable", "check_contract", "contract_for", "violations"]
