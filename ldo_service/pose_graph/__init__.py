"""Pose graph of keyframes and landmarks (LDO-SLAM paper, III.C).

Only this package imports gtsam. gtsam holds the GIL during every call, so the pose-graph optimizer
runs in its own process.

The unknowns are T_k, the pose of keyframe k in the map; mu_l [3], the centroid of landmark l; and
p_l, the distribution of landmark l over C classes. The paper has four kinds of edges, which are
factors of the graph with these costs:

    odometry      |log(T_ab^-1 T_a^-1 T_b)|^2_Omega          tracking, keyframe refinements
    loops         rho(|log(T_ab^-1 T_a^-1 T_b)|^2_Omega)     verified loop closures
    observations  s rho(w_kl |pi(T_k^-1 mu_l) - z_kl|^2 / sigma_px^2) + lambda w_kl KL(p_l || q_kl)
    similarity    w_sem / 2 (KL(p_i || p_j) + KL(p_j || p_i)) [argmax p_i = argmax p_j],
                  landmarks i, j that a keyframe shows together

T_ab is the measured pose of keyframe b in keyframe a. |x|^2_Omega is x^T Omega x, and Omega is the
information matrix of the measurement. rho is a robust kernel, and pi is the projection into the
image. In keyframe k, landmark l is detected as a box. z_kl is the center of the box, sigma_px is
the standard deviation of this center, and q_kl is the class distribution of the Gaussians in the
box. The factor s = 1/320 accounts for errors common to all observations of an object
(`factors.NoiseConfig`). The weights are lambda = 0.5 and w_sem = 0.1. The bracket [argmax ...]
is 1 if both landmarks have the same likeliest class, else 0.

The weight w_kl reduces the effect of uncertain observations. It is exp(-2 H(q_kl)) if the entropy H
is above 0.5 nats, else 1. The entropy of p_l is not used, since the weights would then change with
the solution. In the paper, the similarity has a direction from landmark i to landmark j. Here a
pair has no direction, so the cost contains both directions, each with half the weight.

No term depends both on a class distribution p and on a pose T or centroid mu. The sum of all costs
therefore has two parts, F and G, that can be minimized separately. The first term of the
observations is called projections here:

    F(T, mu) = odometry + loops + projections      and
    G(p)     = lambda sum w KL(p_l || q_kl) + similarity

iSAM2 minimizes F incrementally (`pose_graph`). A batch solver minimizes F to check a loop closure
(`loop_closures`). KL is jointly convex, so G is convex in all p together as long as no likeliest
class changes. Repeated minimization over one landmark after the other then converges to the only
minimum (`label_fusion`). Without similarity, this minimum is the weighted geometric mean of the
observations. Its derivation uses the Lagrange multiplier nu of the constraint sum_c p_c = 1. The
sign ~ means "is proportional to":

    d/dp_c [ sum_k w_k p_c log(p_c / q_kc) ] + nu = 0   =>   p_c ~ prod_k q_kc^(w_k / sum w)

`condensation` limits the number of variables in a long run. Marginalization of old keyframes would
leave a dense prior, linearized at the current poses. Later loop closures could not correct this
prior, and could not connect the old keyframes, which would no longer be variables. Instead, the
first of every ten keyframes remains a variable, and the other nine are condensed. One relative
measurement from this variable to the next variable replaces all measurements of the ten keyframes.
This measurement does not depend on poses in the map, so it remains valid after corrections of any
size.

The pose of a condensed keyframe is interpolated between the variables before and after it. A
condensed keyframe becomes a variable again if a loop closure would change its pose relative to
these two variables.
"""
