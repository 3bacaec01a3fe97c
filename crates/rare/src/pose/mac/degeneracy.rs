//! The degeneracy order of a graph (Matula and Beck 1983, in the linear-time form of Batagelj and Zaversnik 2003).

use crate::pose::mac::score_graph::ScoreGraph;

/// All nodes in an order in which the largest number of neighbours that any has after it is as small as possible.
pub(super) fn degeneracy_order(graph: &ScoreGraph) -> Vec<u32> {
    let mut degrees: Vec<usize> = (0..graph.len()).map(|i| graph.neighbours(i).len()).collect();
    // Nodes sorted by degree, where each stands, and where each degree begins.
    let mut order: Vec<u32> = (0..graph.len() as u32).collect();
    order.sort_by_key(|&i| degrees[i as usize]);
    let mut place = vec![0; graph.len()];
    for (at, &i) in order.iter().enumerate() {
        place[i as usize] = at;
    }
    let largest = degrees.iter().max().map_or(0, |&degree| degree);
    let mut begins: Vec<usize> =
        (0..=largest).map(|d| order.partition_point(|&i| degrees[i as usize] < d)).collect();
    for at in 0..order.len() {
        let node = order[at] as usize;
        for &other in graph.neighbours(node) {
            let other = other as usize;
            let degree = degrees[other];
            if degree > degrees[node] {
                // To the front of its degree, which then begins one later.
                let front = begins[degree];
                let moved = order[front] as usize;
                order.swap(front, place[other]);
                place[moved] = place[other];
                place[other] = front;
                begins[degree] += 1;
                degrees[other] -= 1;
            }
        }
    }
    order
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::mac::samples;

    #[test]
    fn no_order_leaves_fewer_neighbours_after_a_node() {
        for (count, seed) in [(0, 0), (1, 0), (20, 1), (150, 2)] {
            let graph = samples::random_graph(count, 0.2, seed);
            let order = degeneracy_order(&graph);
            let mut degeneracy = 0;
            for (at, &node) in order.iter().enumerate() {
                let left = |&i: &u32| {
                    graph.neighbours(i as usize).iter().filter(|j| order[at..].contains(j)).count()
                };
                // Among the nodes left, every order has some that comes first.
                degeneracy =
                    order[at..].iter().map(left).min().map_or(0, |least| least.max(degeneracy));
                assert!(left(&node) <= degeneracy);
            }
            let mut sorted = order.clone();
            sorted.sort_unstable();
            assert!(sorted.into_iter().eq(0..count as u32));
        }
    }
}
