"""Pose graph of keyframes and landmarks (paper, III.C).

Only this package imports gtsam. gtsam holds the GIL during every call, so an importer runs in a
process of its own.

The unknowns are T_k, the pose of keyframe k in the map; mu_l [3], the centroid of landmark l; and
p_l, its distribution over C classes. The paper has four kinds of edges with these costs:

    odometry      |log(T_ab^-1 T_a^-1 T_b)|^2_Omega          consecutive keyframes, refinements
    loops         rho(|log(T_ab^-1 T_a^-1 T_b)|^2_Omega)     verified pairs
    observations  s rho(w_kl |pi(T_k^-1 mu_l) - z_kl|^2 / sigma_px^2) + lambda w_kl KL(p_l || q_kl)
    similarity    w_sem / 2 (KL(p_i || p_j) + KL(p_j || p_i)) [argmax p_i = argmax p_j],
                  landmarks i, j that a keyframe shows together

Here lambda = 0.5 and w_sem = 0.1. z_kl is the center of a detected box, and q_kl the distribution
of the Gaussians in it. The similarity of the paper is directed, but a pair is not, so half of each
direction is used. s = 1/320 accounts for errors that all observations of an object share
(`factors.NoiseConfig`). w_kl = exp(-2 H(q_kl)) above 0.5 nats, else 1: uncertain observations count
less. The entropy is that of the observation, which is known beforehand; with the entropy of p_l,
the weights would change with the solution.

No term has a p together with a T or a mu. So the sum is minimal if both of these are:

    F(T, mu) = odometry + loops + projections      and
    G(p)     = lambda sum w KL(p_l || q_kl) + similarity

iSAM2 solves F incrementally (`pose_graph`); a batch solver solves it to check a closure
(`loop_closures`). G is convex in all p at once as long as the argmax do not change, since KL is
jointly convex. Sweeps that minimize the terms of one landmark after the other converge to its only
minimum (`label_fusion`). Without similarity, the minimum is the weighted geometric mean of the
observations:

    d/dp_c [ sum_k w_k p_c log(p_c / q_kc) ] + nu = 0   =>   p_c ~ prod_k q_kc^(w_k / sum w)

`condensation` bounds the graph of a long run. Marginalization of old keyframes would leave a dense
prior, linearized at their present poses. Later loop closures could not change it, and it would
leave no variable to close a loop with. Instead, the first of every ten keyframes remains a
variable. A relative measurement to the next such variable holds what the other keyframes measured.
The poses of the others are interpolated between both variables. A relative measurement does not
depend on the pose of its ends in the map, so it remains valid after corrections of any size. A
condensed keyframe becomes a variable again if a closure would change its pose between its ends.
"""
