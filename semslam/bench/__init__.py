"""Benchmarks as commands: `semslam bench paper` regenerates every claim of the paper beside what the paper left out.

paper        the order of things: observe, train, localise, build maps, compare, write
work         what all of these share: request, data, pipeline, store
rows         what is compared: estimators with their configurations, and the networks they need
published    the paper's figures
dataset      a folder of `semslam simulate`: its logs, splits and truth

networks     which trainings there are            trainings   one adapter a network
localising   tracks of every row                  tracks      through the pipeline, scored
                                                  peers       other people's packages, in processes of their own
mapping      which maps are built                 maps        at true poses, scored step by step
noise        the same logs with more and with less noise of IMU and wheels

store, jobs  finished work under the digest of what it depends on; independent parts in worker processes
results      all that was found                   statistics  means, 95 % intervals, paired differences
tables       Markdown, CSV, Parquet               figures     SVG
"""
