import gtsam, numpy as np
from backend import convert
from backend.factors import insert_projections, pose_prior, baseline_factor
from backend.noise import PixelNoise
from dualslam.core.interfaces import BundleProblem, BundleResult
from dualslam.core.types import Failure, FailureReason

def adjust_bundle(problem):
    n=len(problem.T_w_cam); base=10_000_000
    graph,values=gtsam.NonlinearFactorGraph(),gtsam.Values()
    for v in range(n):
        values.insert(convert.pose_key(v),convert.to_pose3(problem.T_w_cam[v]))
        if problem.fixed[v]: graph.push_back(pose_prior(v,problem.T_w_cam[v]))
    if problem.scale_pair is not None:
        a,b=problem.scale_pair[0]%n,problem.scale_pair[1]%n
        graph.push_back(baseline_factor(a,b,float(np.linalg.norm(problem.T_w_cam[a,:3,3]-problem.T_w_cam[b,:3,3]))))
    convert.insert_points(values,np.arange(len(problem.xyz)),problem.xyz)
    insert_projections(graph,problem.view_of,problem.point_of,problem.uv_px,problem.sigma_px,convert.to_cal3_s2(problem.K),PixelNoise(1.345))
    params=gtsam.LevenbergMarquardtParams(); params.setMaxIterations(20); params.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    params.setOrdering(gtsam.Ordering(list(range(len(problem.xyz)))+[convert.pose_key(v) for v in range(n)]))
    try: out=gtsam.LevenbergMarquardtOptimizer(graph,values,params).optimize()
    except RuntimeError as e: return Failure(FailureReason.SOLVER,str(e)[:100])
    T,xyz=convert.poses_of(out),convert.points_of(out)
    Tc=np.linalg.inv(T)[problem.view_of]; p=np.einsum("nij,nj->ni",Tc[:,:3,:3],xyz[problem.point_of])+Tc[:,:3,3]
    uv=p[:,:2]/p[:,2:]*[problem.K[0,0],problem.K[1,1]]+problem.K[:2,2]
    chi2=(((uv-problem.uv_px)/problem.sigma_px[:,None])**2).sum(1)
    chi2[p[:,2]<=0]=1e9
    return BundleResult(T,xyz,chi2)
