"""The factor graph of keyframes and landmarks, and how its objective separates (paper, III.C).

gtsam is imported in this package and nowhere else: it holds the GIL during every call, so whoever
imports it runs in a process of its own.

Unknown are T_k, the pose of keyframe k in the map; mu_l [3], the centroid of landmark l; and p_l,
its distribution over C classes. The paper's four kinds of edges, and what they cost:

    odometry      |log(T_ab^-1 T_a^-1 T_b)|^2_Omega          consecutive keyframes, refinements
    loops         rho(|log(T_ab^-1 T_a^-1 T_b)|^2_Omega)     verified pairs
    observations  s rho(w_kl |pi(T_k^-1 mu_l) - z_kl|^2 / sigma_px^2) + lambda w_kl KL(p_l || q_kl)
    similarity    w_sem / 2 (KL(p_i || p_j) + KL(p_j || p_i)) [argmax p_i = argmax p_j],
                  landmarks i, j that a keyframe shows together

with lambda = 0.5, w_sem = 0.1, z_kl the centre of a detected box and q_kl the distribution of what
is in it. The printed similarity has a direction and the pair has none: half of each is taken.
s = 1/320 for what the sights of one object err by together (`factors.NoiseConfig`).
w_kl = exp(-2 H(q_kl)) above 0.5 nats, else 1: what was observed vaguely counts less. The entropy is
that of the observation, known beforehand; that of p_l would change the weights with the solution.

No term holds a p together with a T or a mu. So the sum is least where

    F(T, mu) = odometry + loops + projections      and
    G(p)     = lambda sum w KL(p_l || q_kl) + similarity

are least, each on its own. F is solved incrementally by iSAM2 (`pose_graph`), and from scratch
where a closure asks for more (`loop_closures`). G is convex in all p at once as long as the argmax
stay as they are, since KL is jointly convex; sweeps over the landmarks, each of which goes to the
minimum of its own terms, lead to its only minimum (`label_fusion`). Without similarity that is
the weighted geometric mean of what was observed:

    d/dp_c [ sum_k w_k p_c log(p_c / q_kc) ] + nu = 0   =>   p_c ~ prod_k q_kc^(w_k / sum w)

A long journey is bounded by `condensation`: marginalising the old keyframes would leave a dense
prior, linearised where they are today, that later loop closures could not bend, and no
variable to close a loop with. In its place, of each ten keyframes the first stays a variable; a
relative measurement to the next such one holds what the others knew, and these follow both, each by
its share of the way. A relative measurement says nothing of where its ends are in the map, so
corrections of any size leave it true. A follower that a closure would bend is a variable again.
"""
