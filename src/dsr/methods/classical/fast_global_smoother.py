"""The fast global smoother: weighted least squares, one line of pixels at a time.

Min, Choi, Lu, Ham, Sohn, Do, *Fast Global Image Smoothing Based on Weighted Least Squares*, TIP 2014. The minimiser of

    sum over p of (u_p - f_p)^2 + lambda * sum over neighbours p, q of w_pq (u_p - u_q)^2,  w_pq = exp(-|I_p - I_q| / s)

is approximated by solving the tridiagonal systems of all rows, then of all columns, T times, with
lambda_t = 3/2 * 4^(T - t) / (4^T - 1) * lambda. Sparse data, the low-resolution map at the centres of its pixels, and
their index map are both smoothed and divided, as in the paper. What differs: lambda is in squared low-resolution
pixels, and far smaller than the paper's, which blurs renderings.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from dsr.methods.classical.guided_filter import Guided, GuidedMethod
from dsr.utils.guards import expect_positive

# minimum smoothed confidence; below it digits are lost, and the result is the nearest low-resolution value
_LEAST = 1e-200
_HALF = 0.5 + 1e-6  # maximum distance, in high-resolution pixels, of data from the centre of a low-resolution pixel


@dataclass(eq=False)
class FastGlobalSmoother(GuidedMethod):
    """The fast global smoother of the low-resolution disparity, as sparse data."""

    smoothness: float = 1.0
    sigma_colour: float = 0.03
    iterations: int = 3

    def __post_init__(self) -> None:
        expect_positive(smoothness=self.smoothness, sigma_colour=self.sigma_colour, iterations=self.iterations)

    def filter_maps(self, guided: Guided) -> Tensor:
        """Return the smoothed maps, (N, H, W)."""
        i, j = guided.nearest()
        at_centre = [
            ((where - nearest).abs() * guided.scale <= _HALF).double()
            for where, nearest in ((guided.rows, i), (guided.columns, j))
        ]
        data = guided.maps[:, i[:, None], j]
        index = at_centre[0][:, None] * at_centre[1] * guided.valid[i[:, None], j]
        strength = self.smoothness * guided.scale**2
        both = torch.cat((index * data, index[None]))
        both = smooth(guided.rgb, both, strength, self.sigma_colour, self.iterations)
        enough = both[-1] > _LEAST
        return torch.where(enough, both[:-1] / torch.where(enough, both[-1], 1), data)


def smooth(guide: Tensor, maps: Tensor, strength: float, sigma_colour: float, iterations: int) -> Tensor:
    """Smooth maps, (N, H, W), where the guide, (3, H, W), is smooth; ``strength`` is lambda in squared pixels."""
    # exp(-|I_p - I_q| / sigma) of neighbours, (W - 1, H) and (H - 1, W): the axis that is solved along comes first
    along_rows, along_columns = (
        torch.exp((each[:, 1:] - each[:, :-1]).square().sum(dim=0).sqrt() / -sigma_colour).contiguous()
        for each in (guide.mT, guide)
    )
    for t in range(1, iterations + 1):
        lambda_t = 1.5 * 4.0 ** (iterations - t) / (4.0**iterations - 1) * strength
        maps = solve_lines(lambda_t * along_rows, maps.permute(2, 0, 1)).permute(1, 2, 0)
        maps = solve_lines(lambda_t * along_columns, maps.transpose(0, 1)).transpose(0, 1)
    return maps.contiguous()


def solve_lines(weights: Tensor, right: Tensor) -> Tensor:
    """Solve (1 + A) u = f for all lines at once, with the weighted Laplacian A of each line, (L, N, M).

    Gaussian elimination for tridiagonal systems (Thomas), stable without pivoting because the diagonal dominates. The
    weights are (L - 1, M), lambda w between the neighbours of M lines, and ``right`` is f, N right-hand sides per line.
    """
    length = right.shape[0]
    solution = right.contiguous().clone()
    upper = torch.zeros_like(right[:, 0]).contiguous()  # the eliminated entries above the diagonal
    weights = functional.pad(weights, (0, 0, 1, 1))  # 0 before the first pixel, and after the last one
    for k in range(length):
        before, after = weights[k], weights[k + 1]
        pivot = 1 + after + before * (1 + upper[k - 1])
        upper[k] = -after / pivot
        if k:
            solution[k] += before * solution[k - 1]
        solution[k] /= pivot
    for k in range(length - 2, -1, -1):
        solution[k] -= upper[k] * solution[k + 1]
    return solution
