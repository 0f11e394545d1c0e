"""The Gauss-Newton step and the posterior covariance, compared with the whole system of field and parameters."""

from __future__ import annotations

import torch

from nerif.reconstruction.gauss_newton import AdaptingField, Information


def test_step_and_covariance_are_those_of_the_whole_system():
    """The field c and three parameters t together, solved at once."""
    random = torch.Generator().manual_seed(0)
    projector, slopes, at = (torch.randn(*n, generator=random).double() for n in ((40, 12), (40, 3), (3,)))
    penalty, data = 0.1 * torch.eye(12).double(), torch.randn(40, 1, generator=random).double()
    field = AdaptingField(projector, penalty, 0.0)
    residual, coefficients = field.rest(data), field.fit(data)
    torch.testing.assert_close(data - projector @ coefficients, residual)
    information = Information(slopes.T @ field.rest(slopes))
    joint = torch.cat([projector, slopes], dim=1)
    normal = joint.T @ joint + torch.block_diag(penalty, torch.eye(3).double())
    pull = joint.T @ residual - torch.cat([penalty @ coefficients, at[:, None]])
    torch.testing.assert_close(
        information.step((slopes.T @ residual)[:, 0], at), torch.linalg.solve(normal, pull)[-3:, 0]
    )
    torch.testing.assert_close(information.covariance, torch.linalg.inv(normal)[-3:, -3:])


def test_parameters_without_information_return_to_their_prior():
    """In a batch of two views, the second without data; with a large weight of the data the prior is gone."""
    matrix = torch.stack([torch.diag(torch.tensor([4.0, 1.0])), torch.zeros(2, 2)])
    information, at, pull = Information(matrix), torch.ones(2, 2), torch.stack([torch.ones(2), torch.zeros(2)])
    torch.testing.assert_close(information.step(pull, at), torch.tensor([[0.0, 0.0], [-1.0, -1.0]]))
    torch.testing.assert_close(information.covariance[1], torch.eye(2))
    newton = information.step(pull, at, torch.full((2, 2), 1e6))[0]
    torch.testing.assert_close(newton, torch.tensor([0.25, 1.0]), rtol=1e-4, atol=0)
