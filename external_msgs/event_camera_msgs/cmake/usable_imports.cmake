# The wheels of ROS 2 export the include directories of the machine they were built on with their Python
# targets; CMake refuses imported targets that name a directory which does not exist. Call this after the last
# find_package and before rosidl_generate_interfaces. It changes nothing on an ordinary ROS 2 installation.
function(drop_missing_include_directories)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    if(NOT target MATCHES "__rosidl_generator_py$")
      continue()
    endif()
    get_target_property(directories "${target}" INTERFACE_INCLUDE_DIRECTORIES)
    set(present "")
    foreach(directory IN LISTS directories)
      if(IS_DIRECTORY "${directory}")
        list(APPEND present "${directory}")
      endif()
    endforeach()
    set_target_properties("${target}" PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${present}")
  endforeach()
endfunction()
